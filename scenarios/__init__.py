"""Real flights, simulated plants, excitation designs and studies."""
