"""The executable digital twin (paper, Figure 5): vibration, critical speeds and stability from coefficients."""
