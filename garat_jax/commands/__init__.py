"""The commands of `garat` about models and measurements: they read arguments and hand over."""
