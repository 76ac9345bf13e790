# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export web`: a page that runs the field in a browser (docs/web.md).

`command.py` chooses what the page holds and `page.py` puts it together. In the browser `compact.js` reads the scene and
`order.js` sorts its splats, both in a worker; `field.js` is the network as shaders, `draw.js` projects and blends, and
`app.js` is the camera and the controls.
"""
