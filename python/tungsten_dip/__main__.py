"""``python -m tungsten_dip`` is the command ``tungsten-dip``."""

import sys

from tungsten_dip.cli.entry import tungsten_dip

sys.exit(tungsten_dip())
