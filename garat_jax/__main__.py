"""`python -m garat_jax` is `garat`."""

from garat_jax.cli import entry

entry()
