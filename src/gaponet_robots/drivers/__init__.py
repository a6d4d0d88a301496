"""Drivers: one robot, or one virtual robot, behind `deploy.driver.Driver`. Vendor libraries load when one connects."""
