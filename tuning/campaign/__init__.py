"""The same question over thousands of cases: parameters drawn at random, a kernel over tiles of cases, figures."""
