"""`python -m garat_jax` is `garat`."""

import sys

from garat_jax.cli import main

sys.exit(main())
