"""Push datasets and runs to the Hugging Face Hub or a bucket, and pull them, checked by the hash of every file."""
