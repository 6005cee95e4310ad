"use strict";
for (const widget of document.querySelectorAll(".compare")) {
  const [left, right, view] = widget.querySelectorAll("select");
  const [leftLabel, rightLabel] = widget.querySelectorAll(".divider span");
  const pictures = widget.querySelectorAll(".picture");
  const divider = widget.querySelector("input");

  const show = () => {
    pictures.forEach((picture, index) => {
      picture.classList.toggle("left", index === left.selectedIndex);
      picture.classList.toggle("right", index === right.selectedIndex);
    });
    leftLabel.textContent = left.selectedOptions[0].textContent;
    rightLabel.textContent = right.selectedOptions[0].textContent;
    divider.setAttribute("aria-label", `Divider between ${leftLabel.textContent} and ${rightLabel.textContent}`);
  };
  const move = () => widget.style.setProperty("--at", `${divider.value}%`);
  const look = () => {
    const [x, y, zoom] = view.value.split(" ");
    widget.style.setProperty("--x", x);
    widget.style.setProperty("--y", y);
    widget.style.setProperty("--zoom", zoom);
    widget.classList.toggle("zoomed", zoom !== "1");
  };

  left.addEventListener("change", show);
  right.addEventListener("change", show);
  divider.addEventListener("input", move);
  view?.addEventListener("change", look);
  // A browser that comes back to the page restores what was chosen.
  show();
  move();
  if (view) look();
}
