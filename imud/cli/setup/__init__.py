"""`imud setup`: from a sensor on a cable to samples. Finds, proposes, changes, and takes its changes back.

    attached      what is on the ports and buses        yaml_edit     devices added to the text of the configuration
    ways          what stands between imud and a port   udev          rules for adapters
    plan          what is to be changed, from those     changes       one change: announced, made, undone
    journal       what was changed, on disk             samples       whether samples come

Planning reads a file tree and makes `changes`; only `changes` and `journal` write.
"""
