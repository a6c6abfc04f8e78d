"""Answers and databases as pictures, and as one page."""
