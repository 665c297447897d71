"""`imud watch` and `imud events`: what the running daemon sends, as it comes.

following   one connection to the daemon, or one after another through its restarts; what is said about silent devices
  ├──▶ watch      samples: as a table, as JSON or as CSV
  │      ├──▶ formats   the table, JSON lines and CSV, by name
  │      └──▶ table     the layout for people, in the width of the terminal
  └──▶ events     events: a line each
"""
