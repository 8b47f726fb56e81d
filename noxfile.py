#!/usr/bin/env -S uv run --script
# /// script
# dependencies = ["nox>=2025.10.14"]
# ///
"""The project's tasks for other machines and other versions: ``nox -l`` lists them."""

from __future__ import annotations

import nox

nox.needs_version = ">=2025.10.14"
nox.options.default_venv_backend = "uv|virtualenv"


def _install(session: nox.Session) -> None:
    session.install("--require-hashes", "-r", "locks/dev.txt")
    session.install("--no-deps", "--no-build-isolation", "-e", ".")


@nox.session
def check(session: nox.Session) -> None:
    """Lint, types, import rules."""
    _install(session)
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")
    session.run("lint-imports")


@nox.session
def tests(session: nox.Session) -> None:
    """Run the tests with the pinned versions."""
    _install(session)
    session.run("pytest", "-n", "2", *session.posargs, env={"OPENBLAS_NUM_THREADS": "1"})


@nox.session(default=False)
def newest(session: nox.Session) -> None:
    """Run the tests with the newest versions of all packages."""
    session.install("-e", ".[all]", *nox.project.dependency_groups(nox.project.load_toml(), "dev"))
    session.run("pytest", "-n", "2", *session.posargs, env={"OPENBLAS_NUM_THREADS": "1"})


@nox.session(default=False, venv_backend="uv")
def oldest(session: nox.Session) -> None:
    """Run the tests with the oldest versions that pyproject.toml allows."""
    groups = nox.project.dependency_groups(nox.project.load_toml(), "dev")
    session.install("--resolution", "lowest-direct", "-e", ".[all]", *groups)
    session.run("pytest", "-n", "2", *session.posargs, env={"OPENBLAS_NUM_THREADS": "1"})


if __name__ == "__main__":
    nox.main()
