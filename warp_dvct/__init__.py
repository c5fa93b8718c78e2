"""Insert synthetic objects into real scenes with physically convincing light."""
