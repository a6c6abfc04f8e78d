"""What the weights and numbers that come with the program were learned from.

`queries` collects evidence and learns the weights of the signatures, `posterior` fits and judges the numbers
of the posterior.
"""
