"""dyfn-record: recordings made of RGB-D folders and videos."""
