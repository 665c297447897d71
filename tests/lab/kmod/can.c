// SPDX-License-Identifier: GPL-2.0
/*
 * Fault confinement of a CAN controller on demand: QEMU's controllers share a
 * perfect bus and never make errors.
 *
 *   echo "can0 bus-off" > /sys/module/imud_lab/parameters/can_fault
 *
 * does what a controller's driver does in its error interrupt: the interface
 * changes its state, an error frame goes to the sockets that want it, and after
 * bus-off the driver's own restart is due.
 */
#include <linux/can/dev.h>
#include <linux/can/error.h>
#include <linux/module.h>
#include <linux/netdevice.h>
#include <linux/rtnetlink.h>
#include <net/net_namespace.h>

static const char *const names[] = {
	[CAN_STATE_ERROR_ACTIVE] = "error-active",
	[CAN_STATE_ERROR_WARNING] = "error-warning",
	[CAN_STATE_ERROR_PASSIVE] = "error-passive",
	[CAN_STATE_BUS_OFF] = "bus-off",
};

static int enter(struct net_device *dev, enum can_state state)
{
	struct can_priv *priv = safe_candev_priv(dev);
	struct can_frame *frame;
	struct sk_buff *skb;

	if (!priv || !netif_running(dev))
		return -ENETDOWN;
	if (priv->state == state)
		return -EALREADY;
	skb = alloc_can_err_skb(dev, &frame);
	if (!skb)
		return -ENOMEM;
	can_change_state(dev, frame, state, state);
	if (state == CAN_STATE_BUS_OFF)
		can_bus_off(dev);
	netif_rx(skb);
	return 0;
}

static int can_fault_set(const char *value, const struct kernel_param *param)
{
	char name[IFNAMSIZ], fault[16];
	struct net_device *dev;
	int result = -EINVAL;

	if (sscanf(value, "%15s %15s", name, fault) != 2)
		return -EINVAL;
	rtnl_lock();
	dev = __dev_get_by_name(&init_net, name);
	for (int state = 0; dev && state < ARRAY_SIZE(names); state++)
		if (!strcmp(fault, names[state]))
			result = enter(dev, state);
	rtnl_unlock();
	return result;
}

static const struct kernel_param_ops can_fault_ops = { .set = can_fault_set };
module_param_cb(can_fault, &can_fault_ops, NULL, 0200);
MODULE_PARM_DESC(can_fault, "INTERFACE STATE: let a CAN controller enter an error state");
