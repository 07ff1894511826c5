"""The executable digital twin (paper, Figure 5): vibration, critical speeds, stability from coefficients."""
