"""Commands that have to fail."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from lanenet.cli.app import app


def refused(folder: Path, *words: object, writes: str = "") -> str:
    """Run a command that must fail with one line and write nothing into a folder; returns the line.

    Args:
        folder: Whose files and folders have to be the same afterwards.
        words: The command.
        writes: Name of a folder that it may write all the same.
    """

    def listed() -> list[Path]:
        return sorted(p for p in folder.rglob("*") if not writes or folder / writes not in (p, *p.parents))

    before = listed()
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 1, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1 and "Traceback" not in result.output
    assert listed() == before, "something was written"
    return lines[0]
