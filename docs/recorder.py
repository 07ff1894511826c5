"""``python docs/recorder.py COMMAND ...``: run a command whose stages share one import of MLflow.

Each stage of `dvc repro` is a process of its own, and so is its recorder, which works 4 s to import MLflow and 0.5 s to
log. Here MLflow is imported once, and each recorder is a fork of that process (Linux, macOS).
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path

from pipeline.errors import MISTAKE
from pipeline.tracking.tracker import SHARED, become_silent, import_mlflow, serve


def main(command: Sequence[str]) -> int:
    """Run the command, and return its exit code."""
    if not command or not shutil.which(command[0]):
        came = f"got '{command[0]}'" if command else "there is none"
        print(f"python docs/recorder.py must have a command to run, such as dvc repro, but {came}", file=sys.stderr)
        return MISTAKE
    with tempfile.TemporaryDirectory(prefix="recorder-") as folder:
        address = str(Path(folder, "socket"))
        # Stages that come while MLflow is being imported wait in the line.
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(address)
            listening.listen()
            process = multiprocessing.get_context("fork").Process(target=_share, args=(listening,), daemon=True)
            process.start()
        signal.signal(signal.SIGINT, lambda *_: None)  # Ctrl-C is the command's, too: it says how it ends
        code = subprocess.call(command, env=os.environ | {SHARED: address})
        return code if code >= 0 else 128 - code


def _share(listening: socket.socket) -> None:
    """Fork for each command that asks, until the one that all are started by has ended."""
    parent = multiprocessing.parent_process()
    become_silent()
    import_mlflow()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the forks
    while parent is not None and parent.sentinel not in wait([listening, parent.sentinel]):
        accepted, _ = listening.accept()
        with accepted:
            if not os.fork():
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                _serve(Connection(accepted.detach()))


def _serve(connection: Connection) -> None:
    folder, environment = connection.recv()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    connection.send(os.getpid())
    serve(connection)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
