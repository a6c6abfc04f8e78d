"""What the weights and numbers that come with the program were learned from.

`queries` collects evidence; `signatures` learns the weights of the signatures, `posterior` and `in_space` fit
and judge the numbers of the posterior.
"""
