"""From a link's bytes to the publishers: the hot path, and the life of each device around it."""
