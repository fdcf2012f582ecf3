"""``python -m geomtact``: the command line."""

from geomtact.cli import main

if __name__ == "__main__":
    main()
