# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Help of each command of the `starcal` tool: summary, description, examples."""

from __future__ import annotations

# Examples: a comment, then the line to type.
HELP: dict[str, str] = {
    'demo': """\
calibrate a small bag with the real ROS nodes

Starts the nodes, plays ten simulated images to them, requests a calibration through the service
and prints the result and the truth.

  # write to the folder starcal_demo
  starcal demo
  # write to another folder
  starcal demo -o first_look""",
    'init': """\
write the first parameter file of a bag or of photographs

Finds the camera from the stars of the images, and if the bag has attitudes, their direction and
the alignment. Writes params.yaml and camera.yaml, and lists the values that were found and those
that you have to state.

  # the bag in the repository, without prior knowledge
  starcal init bags/tiny -o first
  # photographs of the night sky
  starcal init 'night/*.jpg' -o first""",
    'inspect': """\
list the contents of a bag and the images a calibration would refuse

Lists topics, rates, stamps, encodings and gaps, and checks each image against the attitudes as a
calibration does. With --params it also measures the stars.

  # check stamps and attitudes
  starcal inspect bags/tiny
  # also measure the stars, as "starcal calibrate" does
  starcal inspect bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal inspect bags/tiny --json

exit status: 0 the bag can be calibrated; 3 it cannot, with the reasons; 2 bad input.""",
    'diagnose': """\
find out why the images of a bag match no star

Identifies some of the first images without attitude or alignment, compares the attitudes,
alignment and camera with them, and prints the error, the evidence for it and the lines of the
parameter file that correct it.

  # find the cause if no image matches
  starcal diagnose bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal diagnose bags/tiny --params bags/tiny/params.yaml --json

exit status: 0 the set-up is right; 3 it is wrong, or the cause is unknown; 2 bad input.""",
    'calibrate': """\
calibrate from bags, without a ROS graph

Measures the stars of all images, estimates camera and alignment, checks the result against the
limits of the gate and writes report.html, calibration.json, camera_info.yaml and observations.mcap
to DIR. Images without attitudes give the camera alone: their attitudes are found from the stars.

  # the bag in the repository
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out
  # photographs of the night sky alone
  starcal calibrate 'night/*.jpg' -o out
  # the images of the first 30 s
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out --to +30
  # one of several cameras, from two bags together
  starcal calibrate night1 night2.mcap --params camera1.yaml -o out --image-topic /camera1/image
  # repeat from the recorded observations, with other options and without images
  starcal calibrate out/observations.mcap --params bags/tiny/params.yaml -o again""",
    'compare': """\
compare two calibrations in pixels and sigmas

A and B are calibration.json files or folders with one. Lines of sight are compared in the star
tracker frame, before and after removing their common rotation. Differences are B minus A; their
sigmas assume that A and B are independent.

  # two runs
  starcal compare out again
  # with the truth of a simulated bag
  starcal compare out sim/truth.json
  # with a map of the difference over the detector
  starcal compare out again -o difference.svg
  # machine-readable output
  starcal compare out/calibration.json again/calibration.json --json""",
    'plan': """\
propose the next pointings of the camera

Calibrates from the images so far. Then it chooses the allowed pointings one by one, each time the
one that lowers a sigma most, and prints the sigma expected after it.

  # the next ten images, anywhere on the sky
  starcal plan bags/tiny --params bags/tiny/params.yaml
  # five images, within 60 degrees of the zenith of Houston, away from the Sun
  starcal plan bags/tiny --params bags/tiny/params.yaml --images 5 \
      --within 250 30 60 --avoid 83 23 40 -o pointings.csv""",
    'report': """\
rewrite report.html of a calibration

Makes one page from the files of a folder: gate verdict, parameters, residuals, uncertainties,
refused images and stars. The page needs no network. --pdf writes it as numbered pages with a block
for signatures (extra pdf).

  # from the files of an earlier calibration, with pages to sign
  starcal report out --pdf
  # of the last calibration of a calibrator, from its state_dir
  starcal report state""",
    'lookup': """\
write a table of lines of sight and their sigma by pixel

Writes u_px, v_px, the unit vector x, y, z in the camera frame, shape_sigma_arcsec (1-sigma of the
direction, common rotation removed) and sigma_arcsec (in the star tracker frame). The lines of
sight include the residual field if there is one.

  # 25 x 25 pixels over the detector
  starcal lookup out -o lines_of_sight.csv
  # every 16 pixels, for interpolation
  starcal lookup out -o lines_of_sight.npz --step 16""",
    'play': """\
play a bag on the ROS graph

Publishes the messages of a bag with their own stamps, for the nodes to calibrate from.

  # in real time
  starcal play bags/tiny
  # as fast as the stars are observed
  starcal play bags/tiny --rate 0
  # on another topic
  starcal play bags/tiny --remap /opnav/image_raw:=/camera/image_raw""",
    'monitor': """\
show running nodes in the terminal

Shows images and refusals by reason, coverage, for each parameter the forecast sigma and that of
the active calibration, the gate and the health of the nodes.

  # live, until Ctrl-C
  starcal monitor
  # nodes in a namespace
  starcal monitor --remap __ns:=/cam1
  # one view after five seconds, for a log
  starcal monitor --once 5""",
    'simulate': """\
render a bag with known truth

Renders images of real stars with a simulated camera and writes the truth, a prior camera and a
parameter file beside the bag.

  # 24 images of 1296 x 1024, in a few seconds
  starcal simulate -o sim --scenario small
  # calibrate them
  starcal calibrate sim --params sim/params.yaml -o out
  # another draw of the camera and the noise
  starcal simulate -o sim2 --scenario small --seed 2
  # the camera of sim with other noise, twelve stars in each image
  starcal simulate -o sim3 --scenario small --seed 3 --camera-seed 1 --stars-per-image 12
  # a deliberate mistake, to practise the diagnosis
  starcal simulate -o mirrored --scenario tiny --flip""",
    'export': """\
write a calibration in the format of another tool

Writes SPICE kernels (FK and IK, or CK with the attitude of each image), an ALE fragment and ISIS
keywords, YAML of OpenCV, kalibr or ROS, arguments of GIANT, a model of mrcal, a table of lines of
sight, or C99 source; prints the parts that the format cannot represent and the error in pixels
that this causes. SPICE kernels, tables and C represent the whole camera.

  # frame and instrument kernel, including the star tracker frame
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-id -999100
  # with the frame names of the mission, whose frame kernel defines the star tracker
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-frame MSN_ST1
  # attitude of the camera at each image, by its stars
  starcal export out --to ck -o kernels --spacecraft-id -999 --kernels naif.tls clock.tsc
  # for cv2.projectPoints
  starcal export out --to opencv -o opencv
  # C99 for flight software, and a later calibration as a table for it
  starcal export out --to c -o src
  starcal export newer --to c --table -o uplink""",
    'import': """\
make a bag from images and attitudes in the formats of a mission

Images are FITS (also tiled, scaled or floating point), TIFF or PNG. Attitudes of one or more star
trackers are CCSDS AEM, CSV, SPICE CK with SCLK and LSK, or the WCS of a program such as
astrometry.net. Velocities are CCSDS OEM, CSV or SPK. Times in UTC, TAI, TT, TDB and GPS are
converted to UTC. With --camera it also writes a parameter file to calibrate the bag.

  # FITS and an attitude ephemeris
  starcal import --images 'night/*.fits' --attitude attitude.aem -o bag --camera prior.yaml
  # SPICE kernels for attitude and velocity
  starcal import --images 'night/*.fits' --attitude ck.bc clk.tsc lsk.tls --star-tracker ST1 -o bag
  # FITS solved by astrometry.net, which writes NAME.wcs for NAME.fits
  starcal import --images 'night/*.fits' --attitude 'night/*.wcs' -o bag --camera prior.yaml
  # PNG with a table of times and one of attitudes
  starcal import --images 'night/*.png' --times times.csv --attitude attitude.csv -o bag""",
    'catalog': """\
make a deeper star catalog from a table of Gaia

For narrow fields: adds the stars of a table of Gaia DR3 to the bundled catalog, which ends at V =
9. The table covers the sky of the images, with the columns source_id, ra, dec, pmra, pmdec,
parallax, phot_g_mean_mag and bp_rp, or their VizieR names.

  # stars of one field, from the Gaia archive
  starcal catalog gaia.vot -o deep.npz""",
    'trend': """\
follow calibrations over years

Adds every calibration.json and state folder under ROOT to a table in DIR, one SQLite file. With
--params it calibrates bags too. Observations of older versions are calibrated again. Writes
trend.html: each parameter, boresight and alignment over time, steps and drifts with p-values, and
the change that a recalibration would have made.

  # all calibrations of a mission; another run adds only new ones
  starcal trend mission -o trend
  # a thousand bags on two processes
  starcal trend fleet -o trend --params camera.yaml --workers 2
  # on a Dask cluster with access to the same files
  starcal trend /data/fleet -o trend --params camera.yaml --scheduler tcp://host:8786""",
}
