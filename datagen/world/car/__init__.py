"""The simulated car: its motion, its camera, its scripted driver, and the pilots of closed-loop drives."""
