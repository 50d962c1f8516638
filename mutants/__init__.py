"""Mutation testing: small faults, put into the code one at a time and tried with tests that run them."""
