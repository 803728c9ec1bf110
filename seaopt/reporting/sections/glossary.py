"""The meaning of terms in tables, which a page shows under the pointer without a script or a network."""

from __future__ import annotations

import html
import re

GLOSSARY = {
    "Ms": "Largest sensitivity |S| = |1/(1 + L)| over frequency: by how much feedback amplifies disturbances at worst. "
    "1/Ms is the distance of the open loop from -1.",
    "Mt": "Largest complementary sensitivity |T| = |L/(1 + L)| over frequency; 1/Mt is the relative error of the model "
    "that the loop survives.",
    "disk margin": "How much gain and phase may change at once before the loop is unstable: by any factor inside a "
    "disk of this size.",
    "gain margin": "Factor by which the open loop's gain may change before the loop is unstable.",
    "phase margin": "Phase that the open loop may lose where its gain is 1 before the loop is unstable.",
    "delay margin": "Delay that may be added to the loop before it is unstable.",
    "friction margin": "Steepest friction, counted from its flattest slope, for which stability is proved.",
    "bandwidth": "Lowest frequency at which the response to the reference is 3 dB below its value at 0 Hz.",
    "tracking band": "Frequencies at which the response to the reference is within 3 dB of 1.",
    "sensitivity bandwidth": "Frequency up to which |S| is below -3 dB: slower disturbances are reduced.",
    "noise gain": "Largest gain over frequency from sensor noise to the motor's effort.",
    "droop": "How far the response to the reference falls below its static value up to a third of the bandwidth.",
    "reference peak": "Largest gain over frequency from the reference to the output, over its static value.",
    "std": "Standard deviation of the estimate, with coloured residuals allowed for.",
    "95 % interval": "Contains the true value in 95 of 100 repetitions, if the model is right.",
    "held out": "Fit over samples that the parameters were not fitted to.",
    "one step": "Fit of the prediction one sample ahead, which knows the samples before.",
    "whiteness p": "Probability that residuals as coloured as these come from white noise alone.",
    "BIC": "Bayesian information criterion: lower is better; a difference beyond 10 is very strong evidence.",
    "AIC": "Akaike information criterion: lower is better.",
    "overshoot": "How far the output exceeds a step of the reference, in percent of the step.",
    "radius": "Largest absolute eigenvalue of the sampled loop; below 1 the loop is stable.",
}
GLOSSARY.update({head: GLOSSARY[f"{head.split()[0]} margin"] for head in ("disk", "gain dB", "phase °", "delay ms")})
_TERM = re.compile("|".join(rf"(?<![\w|]){re.escape(term)}(?!\w)" for term in sorted(GLOSSARY, key=len, reverse=True)))


def explain_terms(text: str) -> str:
    """Return escaped HTML with each term of the glossary marked by its meaning."""
    return _TERM.sub(lambda match: f'<abbr title="{html.escape(GLOSSARY[match[0]])}">{match[0]}</abbr>', text)
