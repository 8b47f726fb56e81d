"""The labelled bodies of a scan, found in its grey values or given as labels."""
