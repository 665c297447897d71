"""Samples, events, losses, diagnoses as messages of other programs: ROS 2, Foxglove, tables. No I/O but on given files.

          ┌─ json_channels   JSON with schemas; attitude and events in those of Foxglove ─┐
channel ──┤                                                                               ├─▶ mcap_file, live server
          └─ ros2_channels   CDR with definitions of ROS 2 (ros2_types, cdr)             ─┘
diagnosis   how devices are, of a live daemon and of a recording
table       rows of CSV
"""
