"""The words of docs/proof.md; numbers are filled in by `page`."""

ABOUT = """\
{count} recordings by the [blind generator](../test/blind/equations.md), which shares neither code nor
functional forms with the package ({forms} forms).{warning} For each, effect, strength, scene and seed were
drawn at random, the sha256 of the truth was appended to the [ledger](proof/{ledger}) and the truth moved
away; `rim diagnose` was run on recording, camera file and scene file; then the truth was opened, its hash
compared, and the report scored. Measured with {state}. Repeat it with `{command}`."""

STATE = """\
commit `{commit:.12}`, package `{package:.16}`, generator `{generator:.16}` (sha256 over the sources)"""

NOT_SCORING = " **These are not the scoring forms: the figures prove nothing.**"

DEFINITIONS = """\
A rate, or a median, counts as met when it is itself; its 95 % interval (Wilson's; distribution-free) says
what the number of cases is worth. The measures in full:

- *Named right*: the effects under `missing` are exactly those left out. For sections that every camera file
  has (noise, radiometry, camera constant, lens distortion) the name under `adjusted` with the verdict
  `wrong_parameters` counts as well. *Named wrongly*: any effect is named that was not left out, be it beside
  the right one; `unknown` is no name. A null is right with the verdict `consistent` only.
- *Twice the smallest visible size*: the RMS of the effect over its own pixels' single-frame sigma is at least
  twice the size at which half of the cases are *noticed* (verdict other than `consistent`; a logistic curve,
  see below), or the RMS over the median sigma is at least {certain:g}. Noticed, not named: an effect that is
  always misnamed must not excuse itself. Tiers plain, masked and faint.
- *Among the rivals*: every left-out effect is named, or in a set of `indistinguishable` with one that is.
- *Variance explained*: (chi2_before - chi2_after) / (chi2_before - chi2_true), chi-squares per value of
  held-out poses. chi2_true is that of the same recording without the effect (same seed, same noise), compared
  with the true known terms: what the truth refitted leaves. Cases of all tiers, named or not, in which
  chi2_before - chi2_true is at least {excess:g}; noise and interference, which have no mean, are left out.
- *Interval*: parameters that mean the same in the hidden form: scale of distance (whose clock warms up by a
  tenth in the scoring form: the interval must reach the range of slopes) and offsets of the integration
  times; in the tuning forms also time between samples, coefficient of air temperature, strength of the light
  by way of another surface. Per parameter: {covered}.
- *Overlap*: regions that hold 90 % of the mean square over poses of effect / sigma. The generator's map is
  the root of that and is squared first{root}. Cases named right whose true region is below 60 % of the array.
- *Concealed*: the tier *cancelled*, and cases with an identifiability below 2 % (as the report states it,
  else the share of energy that the refit of the known terms left). *Confidently wrong*: a false name that is
  not tied to a true one, unless it leads with a probability below 0.5."""

VISIBLE = """\
Right: of all cases but the faint ones. Sizes are RMS of the effect over the single-frame sigma of its pixels:
where half of the cases are noticed,
and where half are named right, by logistic curves with a slope common to all effects ({slope:.1f} per unit of
ln(size); weak priors keep points finite where all cases are seen, or none: `<` and `>` mark points outside
the sizes that were tried). The two curves are fitted one by one: where few cases lie between them the second
may come out below the first. The last column: named right of those at twice the size noticed."""

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
{count} cases that were not named right, faint and concealed ones included: number, what was left out, answer.
A name stands for all draws from the master seed; this makes a case anew, judges it and keeps recording, truth
and report:

    python -m test.blind --forms {forms}{seed} --only {name} --keep --out case"""
