"""``python -m comvla_client`` is the command ``comvla``."""

import sys

from comvla_client.cli import main

sys.exit(main())
