"""Axes and attitude: what a device sends, how it is mounted, and what is published; no I/O.

    decoded values ──mounting──▶ body (x forward, y left, z up) ──convention──▶ what readers get

`conventions` has the names, `mounting` the rotation sensor → body, `published` what comes out and the conversion of
samples, `gravity` the comparison of attitude and acceleration at rest.
"""
