"""What can be stimulated and recorded: the contract, and one file per kind of culture; what drives hardware is in
`devices`."""
