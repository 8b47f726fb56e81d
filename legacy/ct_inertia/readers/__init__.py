"""Volume readers, one format a file; each imports only its format's library."""
