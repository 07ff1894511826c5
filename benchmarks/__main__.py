"""``python -m benchmarks``: measure, print, and write the page if asked to."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

from benchmarks.measure import BENCHMARKS, Benchmark, Measured
from benchmarks.report import markdown, row

_MODULES = ("modelling", "growth", "peers", "training", "noise", "studies", "startup", "patience")


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0, however long anything takes; 2 for a name that is none."""
    # The matrices are small: threads of BLAS would wait for each other longer than they work.
    for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(threads, "1")
    found = benchmarks()
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Ratios of speed. No time fails it.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all if none is given: {', '.join(found)}")
    parser.add_argument(
        "--write", type=Path, metavar="FILE", help="write the page, such as docs/measured/benchmarks.md"
    )
    given = parser.parse_args(arguments)
    unknown = [name for name in given.names if name not in found]
    if unknown:
        parser.error(f"NAME must be a benchmark, but got '{unknown[0]}': choose from {', '.join(found)}")
    load = os.getloadavg()[0]
    results, failed = measure([found[name] for name in given.names or found])
    if given.write is not None:
        from pipeline.files import write_text

        write_text(given.write, markdown(results, failed, load))
        print(f"written to '{given.write}'")
    return 0


def benchmarks() -> Mapping[str, Benchmark]:
    """All, by name."""
    for module in _MODULES:
        import_module(f"benchmarks.{module}")
    return BENCHMARKS.found


def measure(chosen: Sequence[Benchmark]) -> tuple[list[Measured], list[tuple[Benchmark, str]]]:
    """Results, each printed when it is there, and what could not be measured with its reason."""
    import torch

    torch.set_num_threads(1)
    results: list[Measured] = []
    failed: list[tuple[Benchmark, str]] = []
    for benchmark in chosen:
        try:
            results.append(Measured(benchmark, benchmark.run()))
        except Exception as error:  # one that breaks must not cost the measurements of the others
            failed.append((benchmark, f"{type(error).__name__}: {error}".splitlines()[0]))
            print(f"{benchmark.name}: {error}", file=sys.stderr, flush=True)
            continue
        name, ratio, spread, aim, met, ours, peer = row(results[-1])
        print(f"{name}: {ratio} ({spread}), aim {aim}: {met}; ours {ours}, peer {peer}", flush=True)
    return results, failed


if __name__ == "__main__":
    sys.exit(main())
