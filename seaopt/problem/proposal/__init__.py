"""A problem file proposed from raw logs, with the questions that they leave open."""

from seaopt.problem.proposal.propose import Proposal, ProposedColumn, propose
from seaopt.problem.proposal.questions import Question

__all__ = ["Proposal", "ProposedColumn", "Question", "propose"]
