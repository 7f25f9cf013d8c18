"""What the benchmarks of speed time: our learners, other libraries', the engine alone."""
