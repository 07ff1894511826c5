"""What is asked: a measurement, its equations at the bearings and at the sensors, and what they determine."""
