"""No tests: a command that hears Ctrl-C, also where a background shell has started the tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

DNNMSO = Path(sys.executable).with_name("dnnmso")
LISTEN = "import os, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"


def started(*args: object, **options: Any) -> subprocess.Popen[str]:
    """`dnnmso` with these arguments; options are those of Popen."""
    command = [sys.executable, "-c", f"{LISTEN}; os.execv(sys.argv[1], sys.argv[1:])"]
    return subprocess.Popen([*command, str(DNNMSO), *map(str, args)], text=True, **options)
