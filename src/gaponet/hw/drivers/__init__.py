"""Drivers: one robot each, behind `hw.control.driver.Driver`.

Vendor libraries are imported when a driver connects.
"""
