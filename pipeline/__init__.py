"""From a study file to the report of an ear, and from many ears to laws."""
