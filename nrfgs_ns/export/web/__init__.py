# SPDX-License-Identifier: Apache-2.0
"""`nrfgs export web`: a page that runs the field in a browser (docs/web.md).

`command.py` chooses what the page holds and `page.py` puts it together. In the browser `compact.js` reads the scene and
`order.js` sorts its splats, both in a worker; `field.js` is the network as shaders, `draw.js` projects and blends,
`camera.js` knows cameras and ways between them, `people.js` the controls, `interface.js` what other pages may ask, and
`app.js` moves the camera and keeps the picture up to date.
"""
