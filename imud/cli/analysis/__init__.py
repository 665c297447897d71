"""`imud noise` and `imud spectrum`: judge a sensor by its samples. Only these commands import numpy (extra `analysis`).

commands  arguments, the file or device ──▶ taking   samples into arrays, with where they come from
              │                                └──▶ sheet   figures of a data sheet
              ├──▶ noise_report ──▶ noise_page      text and JSON; a page for a supplier
              └──▶ spectrum_report ──▶ spectrum_live    text, JSON, picture; redrawn in the terminal
"""
