"""Drivers: one robot, or one virtual robot, behind `hw.control.driver.Driver`. Vendor libraries load when one
connects."""
