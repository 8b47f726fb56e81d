"""`stapeskit app`: from a scan and a vibrometer file to M, K and D in one page in the browser.

Everything that the page does stands in plain modules on the public functions of the other rooms; `app.page`
lays it out (marimo) and `app.picture` shows it (ipyniivue). The study file is the only truth: every step is
a run of it, so that ``scan2kd`` repeats the numbers.
"""
