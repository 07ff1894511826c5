"""The conventional methods beside the network: a measurement in; coefficients with their deviations out."""
