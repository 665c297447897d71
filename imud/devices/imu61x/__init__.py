"""Forsense IMU61x: IMU612, IMU614, IMU618, IMU6132A and IMU6132B. One file per wire protocol, what is the same shared.

Source: "IMU61X Interface Protocol and Instructions". Where code departs from it, it says why.
"""
