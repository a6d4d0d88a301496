"""Push datasets and runs to the Hugging Face Hub, and pull them, checked by the hash of every
file.
"""
