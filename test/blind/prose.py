"""The words of docs/proof.md; numbers are filled in by `page`."""

ABOUT = """\
{count} recordings by the [blind generator](../test/blind/equations.md), which shares neither code nor
functional forms with the package ({forms} forms).{warning} For each recording

1. effect, strength, scene and seed were drawn at random,
2. the sha256 of the truth was appended to the [ledger](proof/{ledger}), and the truth was moved away,
3. `rim diagnose` was run on recording, camera file and scene file,
4. the truth was opened, its hash compared, and the report scored.

Measured with {state}. Repeat it with `{command}`."""

STATE = """\
commit `{commit:.12}`, package `{package:.16}`, generator `{generator:.16}` (sha256 over the sources)"""

NOT_SCORING = " **These are not the scoring forms: the figures prove nothing.**"

DEFINITIONS = """\
A demand counts as met when the rate, or the median, meets it. Its 95 % interval (Wilson's; of medians
distribution-free) shows how well the number of cases determines it. The *missing* effect is the one that the
recording contains and the camera file lacks. The measures in full:

- *Named right*: the effects under `missing` are exactly the missing ones. For sections that every camera file
  has (noise, radiometry, camera constant, lens distortion) the name under `adjusted` with the verdict
  `wrong_parameters` counts as well. A null is right with the verdict `consistent` only.
- *Named wrongly*: any effect is named that is not missing, even if it is named in addition to the right one;
  `unknown` is no name.
- *Twice the smallest visible size*: the RMS of the effect over its own pixels' single-frame sigma is at least
  twice the size at which half of the cases are *noticed* (verdict other than `consistent`; a logistic curve,
  see below), or the RMS over the median sigma is at least {certain:g}. The curve is of cases noticed, not of
  cases named, so that an effect which is always misnamed does not escape the measure. Tiers plain, masked and
  faint.
- *Among the rivals*: every missing effect is named, or in a set of `indistinguishable` with one that is.
- *Variance explained*: (chi2_before - chi2_after) / (chi2_before - chi2_true), chi-squares per value of
  held-out poses. chi2_true is that of the same recording without the effect (same seed, same noise), compared
  with the true known terms: what the truth refitted leaves. Cases of all tiers, named or not, in which
  chi2_before - chi2_true is at least {excess:g}; noise and interference, which have no mean, are excluded.
- *Interval*: parameters that mean the same in the hidden form. These are the scale of distance and the
  offsets of the integration times; in the tuning forms also time between samples, coefficient of air
  temperature, strength of the light by way of another surface. In the scoring form the clock of the scale
  warms up by a tenth, and the interval must reach the range of slopes. Per parameter: {covered}.
- *Overlap*: regions that hold 90 % of the mean square over poses of effect / sigma. The generator's map is
  the root of that and is squared first{root}. Cases named right whose true region is below 60 % of the array.
- *Concealed*: the tier *cancelled*, and cases with an identifiability below 2 % (as the report states it,
  else the share of energy that the refit of the known terms left). *Confidently wrong*: a false name that is
  not tied to a true one, unless it leads with a probability below 0.5."""

VISIBLE = """\
- *Right*: of all cases except the faint ones.
- *Half noticed*, *half named*: the size at which half of the cases are noticed, and at which half are named
  right. A size is the RMS of the effect over the single-frame sigma of its pixels. They are from logistic
  curves with a slope common to all effects ({slope:.1f} per unit of ln(size)). Weak priors keep them finite
  where all cases are seen, or none: `<` and `>` mark points outside the sizes that were tried. The two curves
  are fitted separately: where few cases lie between them the second may come out below the first.
- *Named at twice*: named right, of those at twice the size noticed."""

IDENTIFIABILITY = """\
Against identifiability (as the report states it, else what the refit of the known terms left):"""

CONFUSION = """\
What is named first, in the tiers plain, masked, confounded, unknown and null. *Independent BIC* takes every
pixel value as independent, refits the known terms with each candidate and takes the lowest Bayesian
information criterion; *correlation* takes the candidate that correlates best with the residual of the camera
file as it is. Both use the same library of candidates; neither can say `unknown`."""

SIZES = """\
The same seeds at 88 x 72 and at 176 x 144 (the noise is another one). The same answer in {same};
the others:"""

EFFORT = "CPU time of `rim diagnose` with one thread, start of the interpreter included."

MISSES = """\
{count} cases that were not named right, faint and concealed ones included: number, what is missing, answer.
The name of a case determines all draws from the master seed. This command makes a case anew, judges it and
keeps recording, truth and report:

    python -m test.blind --forms {forms}{seed} --only {name} --keep --out case"""
