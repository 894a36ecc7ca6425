"""`python -m dnnmso_mj.doctor [--json]`, for where `dnnmso` itself cannot start."""

from __future__ import annotations

import sys

from dnnmso_mj.doctor import document, examine, is_well, words

findings = examine()
print(document(findings) if "--json" in sys.argv else "\n".join(words(findings)))
sys.exit(not is_well(findings))
