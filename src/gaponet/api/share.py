"""Datasets, runs and robots to and from the Hugging Face Hub."""

from gaponet.share.push_pull import TransferResult as TransferResult
from gaponet.share.push_pull import pull as pull
from gaponet.share.push_pull import push as push
