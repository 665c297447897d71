"""Output `signalk`: deltas of one device for a Signal K server.

publisher  deltas from samples
server     access request, token and verification
client     HTTP requests and WebSocket, within a work budget
websocket  frames
settings   options and row of the output
"""
