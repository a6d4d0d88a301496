"""Writers of other people's formats, as gaponet.data.writers says."""
