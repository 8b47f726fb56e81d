"""Functions that yield how readings can have been labelled, scaled or ordered otherwise; see alternatives."""
