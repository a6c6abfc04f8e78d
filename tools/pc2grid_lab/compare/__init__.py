"""`pc2grid compare`: one file for each command and, beside it, what draws its report."""
