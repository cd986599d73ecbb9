"""Pictures by light paths: their samples, how long they take, and their noise."""
