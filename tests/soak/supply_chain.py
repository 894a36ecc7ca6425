"""Row 14: what is installed is locked, known, licensed and audited; what is built is what it is."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path

from core_install import closure
from packaging.specifiers import SpecifierSet

from dnnmso_mj.environment_names import OWN_NAME
from soak.tally import Form, Tally
from supply import artifacts, audit, environment, licences, lock, sbom
