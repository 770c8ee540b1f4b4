"""What the network is measured against."""
