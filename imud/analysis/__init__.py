"""Noise and vibration of inertial sensors, from arrays of samples. No I/O; needs the extra `analysis`.

series   stamps → true rate, missing samples, even runs
  ├──▶ allan ──▶ noise_terms ──▶ noise      a sensor that lies still: deviation, coefficients, drift
  │                              └──▶ noise_plots
  └──▶ spectrum ──▶ peaks ──▶ spectrum_plots   vibration

Times are seconds or ns, values SI; arrays of a sensor are (samples, 3), the axes x, y, z of the samples.
"""
