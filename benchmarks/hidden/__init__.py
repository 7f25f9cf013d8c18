"""Robots with hidden physical effects, made by C MuJoCo alone, and what a diagnosis is held to."""
