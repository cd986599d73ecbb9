"""Runs the command line by `python -m harnack.cli`."""

from __future__ import annotations

import sys

from harnack.cli import main

sys.exit(main())
