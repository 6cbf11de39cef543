"""`python -m service`. As little as there can be: every worker's process runs through this file, too."""

import os
import sys

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when onnxruntime is imported, so it comes first

if __name__ == "__main__":
    from service.main import main

    sys.exit(main(sys.argv[1:]))
