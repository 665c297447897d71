"""Output `signalk`: deltas of one device for a Signal K server.

publisher   deltas from samples
server      access request, WebSocket and verification
settings    options and row of the output
"""
