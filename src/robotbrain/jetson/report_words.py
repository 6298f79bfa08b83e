"""The prose and the frame of the calibration's report."""

from __future__ import annotations

NOTES = {
    "targets": (
        "<p>The twin predicts the latency of a network from its kernels: a roofline for each kernel, a launch for each,"
        " and one fixed cost. Its coefficients are fitted to latencies that others have published. Everything below is"
        " about rows that the model was <em>not</em> fitted to.</p>"
    ),
    "left out": (
        "<p>Each network is left out in turn with all its rows of one module, precision and harness; the model is"
        " fitted again to the rest and predicts it. A network with and without batch normalisation is the same one once"
        " it is fused, so both go out together.</p>"
    ),
    "kinds": (
        "<p>Absolute relative errors of the left-out rows. <i>FLOPs/peak</i> is the plain alternative: FLOPs over the"
        " dense peak, times one efficiency, the median of the other networks under the same conditions.</p>"
    ),
    "intervals": (
        "<p>Of 80 % intervals, 80 % should hold the truth. The spread comes from the coefficients' covariance, from"
        " effects that no row informs, and from the noise between published runs; it is then scaled so that left-out"
        " rows are covered. Here the scale of a module, precision and harness is found without its own rows.</p>"
    ),
    "transfer": (
        "<p>All rows of a module are left out, so that nothing measured on it is known. A harness that nobody ran on"
        " another module of the same family says nothing about carrying over from one module to another: its own"
        " overhead is unknown too. Such rows stand on a line of their own. <i>FLOPs/peak</i> takes its efficiency from"
        " the other modules of the family with the same precision and harness.</p>"
    ),
    "power": (
        "<p>Power at the wall of developer kits, from MLPerf's MaxQ submissions; each network is left out in turn on"
        " each module. Power of the module alone is never published beside a latency: it is wall power less the loss"
        " of the supply (@SUPPLY@ efficiency, assumed) and the carrier board (assumed, in the catalogue). Networks"
        " whose kernels are not known count as using @USE@ of the peak (assumed).</p>"
    ),
    "check": (
        "<p>Measurements with programs of people's own that none of the harnesses stands for. They are not fitted. The"
        " twin's guess for the nearest harness is beside them: a test of carrying over, and a hard one, since nobody"
        " says what these programs count.</p>"
    ),
    "not used": (
        "<p>No row is left out because the model misses it. These are the rows of the same sources that the fit does"
        " not use, each with its reason.</p>"
    ),
    "origins": (
        "<p>A prediction is <em>predicted</em>, never more. What it is made of: latencies and wall powers"
        " (<em>published</em>, listed here by source; each row of <code>autograder/profiles/calibration</code> has its"
        " own address), clocks, peaks and bandwidths of the modules (<em>datasheet</em> or <em>published</em>, some"
        " <em>assumed</em>), kernels of the networks (counted by this kit's analyser), priors of the coefficients"
        " (<em>assumed</em>).</p>"
    ),
}
"""What stands before each section's figures and tables."""

LIMITS = (
    "<b>Transformers.</b> One transformer (BERT) is in the data, under one harness. Networks of mostly matrix products"
    " can be off by 30 to 60 %; the prediction says so.",
    "<b>trtexec.</b> No published row in the fit was timed by trtexec on its own. Its predictions, which are the"
    " default, are carried over from harnesses with other overheads; hence the wide intervals.",
    "<b>Thor (T4000, T5000).</b> No row was measured on a Blackwell GPU. Its predictions follow from data sheets and"
    " from how the other families behave.",
    "<b>The Nano's torch2trt rows.</b> What that benchmark calls latency is the time of a call from Python, about the"
    " inverse of the throughput that stands beside it: it holds more than the GPU's work. The Nano's other harnesses"
    " borrow from it. Its ResNet-50 in FP16 is published at 26 to 37 frames per second, depending on who timed it.",
    "<b>Versions.</b> The rows span many versions of TensorRT. A version's effect cannot be told from its module's,"
    " since each module was measured with the version of its time.",
    "<b>Families with one harness.</b> Pascal was measured by one project only; its harness and its silicon cannot be"
    " told apart.",
    "<b>DLAs.</b> Their share of the work is counted, their time is not predicted.",
    "<b>Memory and heat.</b> They rest on assumed constants (see above) and were not compared with measurements.",
    "<b>Batches.</b> Every row in the fit is of one input at a time; larger batches are extrapolated.",
)
"""What the twin cannot say; HTML."""

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Calibration of the Jetson twin</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff; margin: 2rem auto; max-width: 64rem;
  padding: 0 1rem; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 2.6rem; border-top: 1px solid #ddd; padding-top: 1rem; }
p, ul { max-width: 46rem; } nav ol { columns: 2 16rem; column-gap: 2.4rem; max-width: 46rem; padding-left: 1.4rem; }
figure { margin: 1.2rem 0; } figure img { max-width: 100%; height: auto; }
figcaption, caption { color: #555; font-size: .9rem; text-align: left; padding: .3rem 0; }
caption { font-weight: 600; color: #1b1b1b; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top; }
thead th { background: #f2f2f2; vertical-align: bottom; } tbody th { font-weight: 500; }
td:not(.words) { white-space: nowrap; }
.words { text-align: left; overflow-wrap: break-word; }
a { color: #0b5394; }
</style></head><body><main>
<h1>Calibration of the Jetson twin</h1>
<p>Made by <code>robotbrain jetson calibrate --report</code> from the data in
<code>autograder/profiles/calibration</code> (digest <code>@DIGEST@</code>).</p>
@BODY@
</main></body></html>
"""
"""Frame of the page."""
