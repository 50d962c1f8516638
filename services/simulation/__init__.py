"""Ground truth that can be photographed: simulated worlds, satellites and images."""
