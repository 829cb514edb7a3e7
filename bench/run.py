"""All benchmarks that `make bench` runs, one after the other."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

for script in ("speed.py", "matching.py"):
    subprocess.run([sys.executable, str(Path(__file__).parent / script)], check=True)
