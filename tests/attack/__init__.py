"""Hostile clients, users and hosts against a running daemon: `make attack`."""
