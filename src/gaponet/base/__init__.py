"""What every sub-package uses: errors, files, checked structures, jobs in other processes, a sandbox."""
