"""Methods that ground a simulator: they change its actions until it moves like the target."""
