"""`imud foxglove`: samples, attitude, events and status of the running daemon for Foxglove, Lichtblick and PlotJuggler.

command   arguments, signals
  ├──▶ relay    reads the daemon, connected again after its restart; asks for samples only while a viewer is connected
  ├──▶ origins  whose pages may read
  └──▶ server   the WebSocket server (foxglove-sdk), which the relay gives messages to
         └──▶ gate   listens, refuses other sites, and joins viewers with that server
"""
