"""MLflow in a process of its own, which imports it while the stage computes: the command then hardly waits for it.

The two speak over a pipe, a line of JSON a record; a process that is lost in between is done without.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import IO

from pipeline.tracking.record import StageRecord, TrackingSettings

_PATIENCE_SECONDS = 10.0
"""How long the process may take to mark a run as killed."""


@dataclass
class _Recorder:
    process: subprocess.Popen[bytes]

    def log(self, record: StageRecord, settings: TrackingSettings) -> list[str] | None:
        """What :func:`pipeline.tracking.tracker.track` says of it in the other process; None where that is gone."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            _send(self.process.stdin, [asdict(record), asdict(settings)])
            answer: list[str] = json.loads(self.process.stdout.readline())
        except (OSError, ValueError):
            return None
        except KeyboardInterrupt:
            self.process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(_PATIENCE_SECONDS)
            raise
        return answer

    def close(self) -> None:
        """No more records: the process ends by itself."""
        with contextlib.suppress(OSError):
            self.process.communicate()


_running: list[_Recorder] = []


@contextmanager
def recorder_beside(enabled: bool) -> Iterator[None]:
    """Stages of the block are logged by another process, which is ready when the first of them ends."""
    if not enabled:
        yield
        return
    command = [sys.executable, "-m", "pipeline.tracking.beside"]
    # In a session of its own: Ctrl-C is for the stage, whose record then says so.
    pipe = subprocess.PIPE
    recorder = _Recorder(
        subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, start_new_session=True)
    )
    _running.append(recorder)
    try:
        yield
    finally:
        _running.remove(recorder)
        recorder.close()


def log_beside(record: StageRecord, settings: TrackingSettings) -> list[str] | None:
    """Let the other process do :func:`pipeline.tracking.tracker.track`; None where there is no such process."""
    return _running[-1].log(record, settings) if _running else None


def _send(stream: IO[bytes], value: object) -> None:
    stream.write(json.dumps(value, default=str).encode() + b"\n")
    stream.flush()


def _serve(requests: IO[bytes], answers: IO[bytes]) -> None:
    """Log what comes until the pipe ends."""
    from pydantic import TypeAdapter

    from pipeline.tracking.tracker import get_ready, track

    get_ready()
    given = TypeAdapter(tuple[StageRecord, TrackingSettings])
    for line in requests:
        _send(answers, track(*given.validate_python(json.loads(line))))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
        _serve(sys.stdin.buffer, sys.stdout.buffer)
    os._exit(0)  # taking MLflow down in order takes a while, and the command waits for it
