"""Agents: policy-gradient learners that step an environment and improve a policy."""

from garat_jax import _mjx as _mjx  # Brax imports MJX too, and would not keep it quiet
