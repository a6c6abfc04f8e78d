"""From proposals to a decision: hypotheses, confidence, answer."""
