"""Arrays in, arrays out: alignment, cameras, registration."""
