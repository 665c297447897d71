"""`imud export`: a recording or a capture as CSV or MCAP.

command   arguments, and what is said at the end
  ├──▶ source    what is exported, in the axes that are wanted; playing: a large recording in a process of its own
  │       └──▶ sinks, mcap_sink      make rows or messages of them (imud.bridges)
  │               └──▶ output        the file or standard output, whole or not at all
  └──▶ progress  the bar on a terminal
"""
