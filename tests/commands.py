"""Commands as a user types them."""

from __future__ import annotations

import shlex
from typing import Any

from og_pointcloud.cli import main


def run(capsys: Any, *arguments: object) -> tuple[int | str | None, str, str]:
    """(exit code, stdout, stderr) of one command."""
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as leaving:  # argparse leaves by itself
        code = leaving.code
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def output_of(capsys: Any, *arguments: object) -> str:
    """What a command that must succeed writes to stdout."""
    code, stdout, stderr = run(capsys, *arguments)
    assert code == 0, stderr
    return stdout


def next_command(stdout: str) -> list[str]:
    """The words of the command that an output says to type next."""
    (line,) = [line for line in stdout.splitlines() if line.startswith("next: ")]
    return shlex.split(line[line.index("og-pointcloud ") :])[1:]


def error_of(capsys: Any, *arguments: object) -> str:
    """The one line that a command which must fail writes."""
    code, _, stderr = run(capsys, *arguments)
    lines = [line for line in stderr.splitlines() if not line.startswith("warning: ")]
    assert code == 2
    assert len(lines) == 1, stderr
    assert lines[0].startswith("error: ")
    return lines[0]
