"""`imud top`: all devices at a glance, and a page of each, redrawn in place.

imud.client.feed   one thread: status, samples, events of the daemon, connected again after its restart
  └──▶ history   what is kept of each device: its newest status, samples of the last minute
         └──▶ rows      text and order of the table
                └──▶ app       the screens and keys (textual)
                       └──▶ command   what is read for which screen
"""
