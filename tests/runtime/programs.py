"""Scripts in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from typing import Any


def run_python(
    script: str, *arguments: str, check: bool = False, capture_output: bool = True, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a script with these arguments and options of `subprocess.run`; its output is text."""
    command = [sys.executable, "-P", "-c", script, *arguments]
    return subprocess.run(command, check=check, capture_output=capture_output, text=True, **options)
