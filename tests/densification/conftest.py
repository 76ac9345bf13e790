# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

# densification_cases.py is a plain module that several test files share.
sys.path.insert(0, str(Path(__file__).resolve().parent))
