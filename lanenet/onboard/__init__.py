"""What runs on the car: the drive loop with its safety, guard, cameras and actuators, and the doctor."""
