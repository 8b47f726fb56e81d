"""One model of what a channel can do wrong, and one estimator of any set of its parameters."""
