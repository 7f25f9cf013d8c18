"""Agents: policy-gradient learners that step an environment and improve a policy."""
