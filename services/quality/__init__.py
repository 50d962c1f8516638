"""How good a registration or a block is: figures, criteria and verdicts."""
