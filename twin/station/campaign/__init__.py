"""``atmd campaign``: a question put to thousands of cases, on threads or a cluster, kept as it goes."""
