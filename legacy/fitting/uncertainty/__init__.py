"""Where the uncertainty of K and D comes from: covariance, profiles, identifiability."""
