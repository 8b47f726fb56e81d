"""Reading CSV tables as laboratories write them, with every fault by row."""
