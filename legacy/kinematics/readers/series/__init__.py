"""Time series: files, channel tables and the estimation of frequency responses."""
