"""`pc2grid compare`: one file for the work of each command and, beside it, what draws its report."""
