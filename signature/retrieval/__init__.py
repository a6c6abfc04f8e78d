"""Which places may a query lie at? Views in, proposals out: signature index, viewpoints, votes."""
