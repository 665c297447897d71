"""Recording of what devices deliver, at the inputs of codecs and clocks, and its replay.

link ──▶ path ──▶ samples        what goes into path and clock is recorded (`tap`), in the order in which it does;
          ▲                      with their state at the begin of a file (`state`) it is all that decides the
lines ────┴── clock ◀── host     samples, so that `player` makes the same ones, bit by bit
"""
