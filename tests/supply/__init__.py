"""What is installed: its lock, its licences, its known vulnerabilities, and what is built of us."""
