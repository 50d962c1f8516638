"""Simulated worlds, satellites and images with exactly known ground truth."""
