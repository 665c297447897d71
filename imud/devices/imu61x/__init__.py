"""Forsense IMU61x: IMU612, IMU614, IMU618, IMU6132A and IMU6132B. A folder per wire protocol; `common` is shared.

Source: "IMU61X Interface Protocol and Instructions". Departures of the code from it are stated where they are.
"""
