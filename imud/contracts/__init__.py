"""Interfaces of codecs, links, drivers, sessions, actions and publishers."""
