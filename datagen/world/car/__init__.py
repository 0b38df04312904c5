"""The simulated car: its motion, its camera, its scripted driver, and who else may steer it."""
