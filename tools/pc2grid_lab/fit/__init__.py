"""What the weights and numbers that come with the program were learned from.

The weights of the signatures: `simulated`, then `signatures`; `shortlists` shows what is lost without them.
The numbers of the posterior: `recorded_queries` collects evidence, `posterior` fits and judges.
"""
