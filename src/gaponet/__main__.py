"""python -m gaponet."""

from gaponet.cli.main import entry

if __name__ == "__main__":
    entry()
