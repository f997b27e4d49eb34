"""The stages on a device that is not the CPU: ``on_device.py`` in a process of its own.

Torch counts its devices at a process's first backward pass, so that the one made for these tests has to come before.
"""

import subprocess
import sys
from pathlib import Path


def test_stages_on_a_device() -> None:
    here = Path(__file__).parent
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(here / "on_device.py")]
    done = subprocess.run(command, cwd=here.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
