# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
# The case builder and the judge are plain modules that several test files share.
sys.path[:0] = [str(HERE), str(HERE.parent / "fixtures")]
