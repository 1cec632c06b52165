"""What makes responses doubtful: the findings, apart from the extraction."""
