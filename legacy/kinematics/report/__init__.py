"""The report on points and degrees of freedom: sections and figures."""
