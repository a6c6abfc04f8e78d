"""From what a look-up finds to an answer: evidence, belief, decision."""
